"""Which steps may be left out or computed more cheaply, and how much does a result change at most?

Cheaper forms of steps, steps without effect, and error bounds for every step.
Nothing here runs a step; a node states its own error bounds.
Offers: `cheaper_steps.with_substitutions`, `skip_decision.judge`, `error_propagation.proof`,
        `error_norm.error_of`.
"""
