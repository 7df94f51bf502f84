"""Which steps may be left out or computed more cheaply, and how much does a result change at most?

Cheaper forms of steps, steps without effect, and bounds of the error at every step.
Nothing here runs a step; a node states its own bounds.
Offers: `cheaper_steps.with_substitutions`, `skip_decision.judge`, `error_propagation.proof`, `error_norm.error_of`.
"""
