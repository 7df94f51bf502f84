"""training/mask_design"""
