"""training/parallel"""
