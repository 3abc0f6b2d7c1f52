"""Samples given to an estimator, a load filter or a monitor, at once or in pieces."""


def pushed(to, *columns, size=None, **more):
    """Push columns, in pieces of a size if one is given; return what took them."""
    if size is None:
        to.push(*columns, **more)
    else:
        for k in range(0, len(columns[0]), size):
            to.push(*(one[k:k + size] for one in columns), **more)
    return to
