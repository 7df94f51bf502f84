"""How are a mask in front of a lens and a network that restores the pictures trained together?

Training pictures from the graph of a recipe, iterations and stages of a training, its state, and
its figures. Settings are read in `recipe.blocks`; networks and losses are nodes.
Offers: `run_training.train`, `training_iteration.Learner`, `training_pictures.TrainingStream`.
"""
