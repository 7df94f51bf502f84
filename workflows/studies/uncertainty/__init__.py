"""studies/uncertainty"""
