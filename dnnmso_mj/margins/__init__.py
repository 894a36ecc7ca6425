"""How much of each imperfection a controller stands: one bisection a controller, row and seed."""
