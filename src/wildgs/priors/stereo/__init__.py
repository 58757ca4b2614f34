"""Depth without a network: PatchMatch multi-view stereo with normalised cross-correlation (NCC).

After Galliani et al. ("Massively Parallel Multiview Stereopsis by Surface Normal Diffusion", ICCV 2015) and
Schönberger et al. ("Pixelwise View Selection for Unstructured Multi-View Stereo", ECCV 2016). NCC is invariant to
affine changes of brightness, which covers most of the difference in lighting between two photos. Depth is kept
where three photos agree; the sky and passers-by, where they do not, get no estimate.
"""
