"""How do outputs scatter over what the recipe is not sure of?

Draws of uncertain values, runs at each, scatter, sensitivities and the page.
Distributions are read in `recipe.distributions`.
Offers: `uncertainty_study.study`.
"""
