"""The checks of ``comvla doctor``: each looks at one thing and gives findings with their remedies."""
