"""Identification and evaluation of bags, for the commands, the nodes and the API."""
