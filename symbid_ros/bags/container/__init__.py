"""Read the files of bags: records, chunks, topics, and messages as bytes."""
