"""How does the error of a recipe's outputs depend on the run time of the recipe?

Settings that trade accuracy for run time, cold runs of each setting, and the work-precision
diagram. Other studies have their own packages.
Offers: `accuracy_study.study`, `recipe_knobs.knobs`.
"""
