"""A simulator as witness: does a box that is pressed as planned stay where it is held?"""
