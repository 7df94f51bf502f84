"""recipe/distributions"""
