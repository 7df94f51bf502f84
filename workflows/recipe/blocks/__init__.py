"""What may the blocks `train`, `train.mask` and `train_lift` say?

The settings of training and of the design of a mask, read and checked where they stand.
Nothing here trains.
Offers: `train_block.Training`, `train_lift_block.LiftTraining`, `mask_design_block.MaskTraining`.
"""
