"""Pointfilter over HTTP. Runs from a checkout or from the image: `python -m service`. Not part of the wheel."""
