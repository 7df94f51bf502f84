"""What may a caller in Python ask for?

The verbs of `neusee`, with one shape of signature for all. A verb reads a recipe, opens the store and calls the room
that answers. It computes nothing itself, and the command line calls the same verbs.
Offers: `verbs.run`, `verbs.sweep`, `verbs.train`, `verbs.evaluate`, `verbs.calibrate`, `verbs.study`.
"""
