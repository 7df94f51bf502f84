"""studies/stability"""
