"""Scans as worlds: meshes, clouds of points and maps of voxels, their files and what becomes of them."""
