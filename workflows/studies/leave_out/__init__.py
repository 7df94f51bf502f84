"""studies/leave_out"""
