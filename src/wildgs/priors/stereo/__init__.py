"""Depth without a network: multi-view stereo by PatchMatch with NCC windows.

After Galliani et al. ("Massively Parallel Multiview Stereopsis by Surface Normal Diffusion", ICCV 2015) and
Schönberger et al. ("Pixelwise View Selection for Unstructured Multi-View Stereo", ECCV 2016). Normalised
cross-correlation does not notice affine changes of brightness, which is most of what differs between the lights of
two photos. What three photos agree on is kept; sky and passers-by, on which they do not, have no estimate.
"""
