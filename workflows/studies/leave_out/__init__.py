"""Does every omission keep its bound, and how much time does it save?

Runs with and without each omission, and the run time of simpler scenes.
No other study belongs here.
Offers: `leave_out_study.study`.
"""
