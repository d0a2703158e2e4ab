"""Work on many machines, by workers of a Dask cluster: logs of an identification, and studies."""
