"""What only an oracle may see."""
