"""The demo's landmark: a made-up place that tourists photograph at every hour, generated in code."""

from demo_generator.photos import SyntheticConfig, make_landmark

__all__ = ["SyntheticConfig", "make_landmark"]
