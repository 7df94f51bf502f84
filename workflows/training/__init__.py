"""How are a mask and a restorer trained on pictures?

Training pictures through the graph of a recipe, the iterations and stages, the state that is kept, and the figures.
Settings are read in `recipe.blocks`; networks and losses are nodes.
Offers: `run_training.train`, `training_iteration.NotFinite`, `training_pictures.TrainingStream`.
"""
