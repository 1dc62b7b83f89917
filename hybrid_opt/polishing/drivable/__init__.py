"""The polish of carries under the time law 'optimal': path and speed profile in one program."""
