"""What pages and figures share: colours, numbers in words, pictures."""
