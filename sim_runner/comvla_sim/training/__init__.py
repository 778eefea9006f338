"""Training of comvla-mini: demonstrations, and what is learnt from them."""
