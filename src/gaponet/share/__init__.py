"""Datasets and runs to and from places on the network, by the hash of every file."""
