"""Accuracy and speed: metrics, published protocols, tables, files and pictures of results."""
