"""Streams of messages to samples on one clock."""
