"""Tests of the product. A package, because some wheels install a top-level `tests` of their own."""
