"""recipe/blocks"""
