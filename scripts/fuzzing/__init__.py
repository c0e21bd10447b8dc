"""The fuzzer of the decoders, of a game and of the settings."""
