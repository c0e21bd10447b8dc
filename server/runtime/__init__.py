"""The process: the ticker, the event loop, logs and errors."""
