"""Choices that the product has rejected, kept so that its own can be measured against them."""
