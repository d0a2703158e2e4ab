"""What lies in a bag's files: chunks, records, topics, messages as bytes."""
