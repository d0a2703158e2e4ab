"""Online identification: estimates from messages as they arrive, with forgetting and changes."""
