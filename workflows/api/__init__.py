"""What may a caller in Python ask for? The verbs of `neusee`, one shape of signature for all.

A verb reads a recipe, opens the store and calls the room that answers; it computes nothing itself. `cli` asks the same.
"""
