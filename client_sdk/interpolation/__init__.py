"""Other entities between two snapshots, and corrections without a jump."""

from client_sdk.interpolation.interpolation import Interpolation

__all__ = ["Interpolation"]
