"""How far do outputs scatter because of uncertain values in the recipe?

Draws of uncertain values, runs at each, scatter, sensitivities and the page.
Distributions are read in `recipe.distributions`.
Offers: `uncertainty_study.study`.
"""
