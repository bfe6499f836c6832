"""Poses, lens models and homographies."""
