"""Does every omission keep its bound, and what does it save?

Runs with and without each omission, and what simpler scenes cost.
No other study belongs here.
Offers: `leave_out_study.study`.
"""
