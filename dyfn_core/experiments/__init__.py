"""The paper's claims, tested again on a base of one's own, each as one command."""
