"""studies/calibration"""
