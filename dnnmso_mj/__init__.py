"""A MuJoCo testbed for the online-learning deep neuro-adaptive dynamic inversion controller."""

from importlib.metadata import version

__version__ = version("dnnmso_mj")
