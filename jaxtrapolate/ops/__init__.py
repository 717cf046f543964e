"""The operations: pure, jitted functions of images, and what they share. Each module reads on its own.

Fetching and scattering: `warp`, `scatter`, `grid`, `guided`, `fill`. What is where: `motion`, `depth`, `ego_motion`,
`holes`, `causes`, `forecast`. Optical flow: `dis` with `patches` and
`refinement`, `farneback`, both on `resample`. Light: `radiance`, `shading`.
"""
