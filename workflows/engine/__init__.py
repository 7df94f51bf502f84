"""How is a recipe run?

What is loaded, what is computed, in which order and where, and what that took; runs as differentiable functions.
Nothing here prints, draws or writes a page, and no formula of physics stands here.
Offers: `runner.run`, `runner.Result`, `differentiable_function.as_function`, `step_job.Executor`,
`provenance.versions`.
"""
