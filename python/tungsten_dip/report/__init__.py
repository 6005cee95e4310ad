"""Metrics against a reference, previews and HTML pages."""
