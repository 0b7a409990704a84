"""From words to vectors: the tokenizer and encoder that the base install runs, banks of words, and stored vectors."""
