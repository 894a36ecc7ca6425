"""Proof of reliability: one module a row of the scorecard in docs/reliability.md.

`make soak` runs every row in its long form, `make soak ROW=5` one; the tests run the short forms.
"""
