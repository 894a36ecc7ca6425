"""`python -m dnnmso_mj` is the command `dnnmso`."""

from dnnmso_mj.cli import main

main()
