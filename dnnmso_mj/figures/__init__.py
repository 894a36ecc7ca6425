"""The figures behind `dnnmso_mj.plots`."""
