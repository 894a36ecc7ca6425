"""Many runs of one scenario: a plan of grid and seeds, an engine that runs it, a table of rows.

`plan.plan_sweep` validates, `run.run_sweep` runs, `summary.summarise` judges. This module imports
nothing, so that a worker process loads only what a run needs.
"""
