"""Which kinds of own nodes could be served stale? Each file holds one family of cases; `case.py` says what a case is."""
