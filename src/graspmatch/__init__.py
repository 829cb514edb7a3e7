"""Grasp planning by parallel shape matching."""
