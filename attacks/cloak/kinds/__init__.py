"""The steps of a study of CLOAK as kinds of jobs (`mi_splat.ledger`);
`attacks.cloak.steps` puts them together.
"""
