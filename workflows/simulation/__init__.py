"""How is one recipe run, and its folder written?

The command `neusee run` without its words: a run, its reasons, its pictures, files and page.
No sweep, training or study belongs here.
Offers: `simulate_recipe.simulate`, `simulate_recipe.Simulation`, `simulate_recipe.recipe_text`.
"""
