"""Is the posterior of a sensor's parameters correct?

Sensors with known parameters are simulated, and the parameters are ranked among draws from the
posterior. The package `calibration` computes the posterior.
Offers: `calibration_study.study`.
"""
