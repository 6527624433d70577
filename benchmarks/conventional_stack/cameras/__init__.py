"""The cameras of the conventional stack: by rays of C MuJoCo, and by image columns as ours."""
