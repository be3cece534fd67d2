"""The physics, once: parameters, linear models, exact discretisation, block kernels."""
