"""Networks as plain pytrees: layers, normalisation, critic heads, policies, exploration."""
