"""Controllers against one another: the same seeds, noise, limits and sampling, paired by seed.

`plan.plan_comparison` makes a sweep of it, with one point a controller; `summary.summarise` says
who is better, and how sure that is; `pairing` holds two of them against each other.
"""
