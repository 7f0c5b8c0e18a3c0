"""What an interpreter is: a result container's bytes in, a value out.

An interpreter keeps nothing between results and guesses nothing. The shortest one is a function
over a :class:`Reader`; one that takes a layout is a subclass of :class:`Interpreter`.
"""
