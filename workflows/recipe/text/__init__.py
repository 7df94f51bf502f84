"""recipe/text"""
