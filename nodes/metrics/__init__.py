"""Metrics: what a reader of results asks for."""
