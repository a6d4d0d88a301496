"""Readers of other people's logs, as gaponet.data.formats says."""
