"""How are a mask in front of a lens and a network that restores the pictures trained together?

Training pictures from the graph of a recipe, iterations and stages of a training, its state, and
its figures; a mask that is designed without pictures, by loss terms of the mask alone; a network
that estimates spectra from RGB. A stopped training continues with bit-identical results. Settings
are read in `recipe.blocks`; networks and losses are nodes.
Offers: `run_training.train`, `training_iteration.Learner`, `training_pictures.TrainingStream`,
        `design_run.design`, `lift_training.train_lift`, `resumable_loop.ResumableLoop`,
        `resumable_loop.NotFinite`.
"""
