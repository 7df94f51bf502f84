"""Restoration: from raw digital numbers back to colour."""
