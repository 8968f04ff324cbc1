"""The structure that lets y follow y_m: gains, preview, behaviour at rest."""
