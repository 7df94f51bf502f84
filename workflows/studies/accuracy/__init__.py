"""How does the error of a recipe's outputs depend on the run time?

Settings that trade accuracy for time, cold runs of each, and the work-precision diagram.
No other study belongs here.
Offers: `accuracy_study.study`, `recipe_knobs.knobs`.
"""
