"""From words to vectors: tokenizer and encoder for the base install, word banks, and stored vectors."""
