"""Losses: what learning minimises."""
