"""studies/accuracy"""
