"""training/lift"""
