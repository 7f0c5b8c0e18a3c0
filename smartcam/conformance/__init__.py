"""Judge from outside, with independent code: is it a BVS camera, or a good client?"""
