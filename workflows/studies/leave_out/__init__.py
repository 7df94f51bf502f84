"""When the engine leaves steps out, does the error stay within its bound, and how much run time is
saved?

Runs with and without each omission, and the run time of simpler scenes.
Other studies have their own packages.
Offers: `leave_out_study.study`.
"""
