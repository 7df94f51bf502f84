"""Does the error of every omission stay within its bound, and how much run time does the omission save?

Runs with and without each omission, and the run time of simpler scenes.
Other studies have their own packages.
Offers: `leave_out_study.study`.
"""
