"""Many scenes: fitted on any number of workers (`fit_many`), indexed into one file (`index`), asked at once
(`collection`)."""
