"""Is the posterior of a sensor right?

Simulated sensors with known constants, and the ranks of these among draws of the posterior.
The posterior itself belongs to `calibration`.
Offers: `calibration_study.study`.
"""
