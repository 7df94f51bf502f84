"""Where do steps break in stiff and extreme cases?

Extreme cases of each step, forward and gradient, against float64.
No other study belongs here.
Offers: `stability_study.study`.
"""
