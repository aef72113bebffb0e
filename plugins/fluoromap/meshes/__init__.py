"""The chamber as a mesh file: PLY, STL, GLB, VTP, OpenEP and CSV."""
