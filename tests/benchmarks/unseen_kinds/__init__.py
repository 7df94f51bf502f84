"""Which kinds of own nodes could be served stale? Each file is one family of cases; `case.py`
says what a case is.
"""
