"""How is a recipe run?

The engine decides which results to load and which steps to compute, in which order and on which
device. It records the cost of each step, and turns a recipe into a differentiable function.
Nothing here prints, draws or writes a page, and no formula of physics is here.
Offers: `runner.run`, `runner.Result`, `differentiable_function.as_function`, `step_job.Executor`,
        `provenance.versions`.
"""
