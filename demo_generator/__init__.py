"""The generator of the demo's scene: a made-up landmark that tourists photograph at every hour."""

from demo_generator.photos import SyntheticConfig, make_landmark

__all__ = ["SyntheticConfig", "make_landmark"]
