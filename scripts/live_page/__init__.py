"""The picture of the live page, taken with a headless Chromium."""
