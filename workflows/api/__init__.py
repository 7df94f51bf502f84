"""Which functions does neusee offer to Python code?

The verbs of `neusee`, all with the same options. A verb reads a recipe, opens the store and calls
the room that computes. The command line calls the same verbs.
Offers: `verbs.run`, `verbs.sweep`, `verbs.train`, `verbs.evaluate`, `verbs.calibrate`,
        `verbs.study`.
"""
