"""The learning audit: does a controller know the plant, or does it only adapt fast?

Weights are frozen at chosen times; then the arm goes on along the same trajectory, along others
that were never seen, and the learned dynamics are held against the true ones. `run.run_audit` does
it all. This module imports nothing, so that a worker process loads only what it needs.
"""
