"""The matrices of blocks, for tests that simulate them by hand."""


def of_one_input(block):
    return block.a, block.b[:, 0], block.c, block.d[:, 0]
