"""The Rerun viewer behind `dnnmso_mj.replay`."""
