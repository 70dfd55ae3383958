"""Devices in pure Python, an independent reading of their manuals; no code shared with codecs or adapters."""
