"""Write new bags so that a crash, a power cut or a full disk costs few messages."""
