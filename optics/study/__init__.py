"""A study: the base model, the effects added to it step by step, and the record of each."""
