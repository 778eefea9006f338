"""The contract between robot and cloud: messages, token codec, model description, errors."""
