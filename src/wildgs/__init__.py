"""Wild-GS: relightable 3D Gaussian scenes from unconstrained photo collections."""

__version__ = "0.1.0"
