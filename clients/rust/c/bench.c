/* Time of one followed point through the C interface. Usage: bench FILE.model.payload [POINTS] */
#include "dehyst.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static int ascending(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv) {
    size_t points = argc > 2 ? strtoul(argv[2], NULL, 10) : 1000000;
    FILE *file = argc > 1 ? fopen(argv[1], "rb") : NULL;
    uint8_t *payload = malloc(1 << 20);
    double *took = malloc(points * sizeof *took);
    if (!file || !payload || !took || !points) {
        printf("usage: bench FILE.model.payload [POINTS]\n");
        return 2;
    }
    size_t bytes = fread(payload, 1, 1 << 20, file);
    fclose(file);
    dehyst_limits limits = {0.0, 10.0, 2e5, -40.0, 140.0};
    dehyst *handle = NULL;
    if (dehyst_open_payload(payload, bytes, &limits, &handle)) {
        printf("%s\n", dehyst_error());
        return 1;
    }
    for (size_t i = 0; i < points + 1000; i++) {
        double phase = 0.02 * (double)i, v = 600.0 * cos(phase);
        dehyst_answer answer;
        struct timespec start, end;
        clock_gettime(CLOCK_MONOTONIC, &start);
        int status = dehyst_point(handle, 45.0 + 30.0 * sin(phase), v, -0.4 * v, &answer);
        clock_gettime(CLOCK_MONOTONIC, &end);
        if (status) {
            printf("%s\n", dehyst_error());
            return 1;
        }
        if (i >= 1000)
            took[i - 1000] = 1e6 * (double)(end.tv_sec - start.tv_sec) + 1e-3 * (double)(end.tv_nsec - start.tv_nsec);
    }
    qsort(took, points, sizeof *took, ascending);
    printf("%zu points through C, µs: p50 %.2f, p99 %.2f, p99.9 %.2f, p99.99 %.2f, max %.2f\n", points,
           took[points / 2], took[points * 99 / 100], took[points * 999 / 1000],
           took[(size_t)((double)points * 0.9999)], took[points - 1]);
    dehyst_close(handle);
    return 0;
}
