"""Every kind of result that a page can show: one module reads one kind into a
`Section`.
"""
