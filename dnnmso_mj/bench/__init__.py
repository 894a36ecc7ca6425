"""`dnnmso bench`: this package against what one would otherwise write or use, in one run.

Each section makes contenders do the same work, first proves that they do (`checks`), and then times
them in turn, round after round, so that whatever else the machine does hits all alike.
"""
