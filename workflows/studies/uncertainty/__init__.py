"""How much do the outputs of a recipe vary because some of its values are uncertain?

Draws of uncertain values, a run at each draw, the scatter and sensitivity of the outputs, and the
page. The package `recipe.distributions` reads the distributions.
Offers: `uncertainty_study.study`.
"""
