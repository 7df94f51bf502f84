"""How is one recipe run, and how is the folder of the run written?

The command `neusee run` without its console output: a run, with the reasons for each step,
pictures, files and page. No sweep, training or study belongs here.
Offers: `simulate_recipe.simulate`, `simulate_recipe.Simulation`.
"""
