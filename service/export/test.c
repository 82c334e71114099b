/* ORIGIN
 * Checks export.c against the voltages of the model: test FILE.csv, the vectors beside this file. Prints the largest
 * difference and the time of a point. Exit status 0 where the stated error holds. */
#include "export.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define MOST 100000
#define TIMES 100

int main(int argc, char **argv)
{
    static export_real motion[MOST][3];
    double worst = 0.0, sum = 0.0;
    int n = 0, wrong = 0;
    char line[256];
    export_state axis;
    FILE *file = argc == 2 ? fopen(argv[1], "r") : NULL;
    if (!file) {
        fprintf(stderr, "usage: test VECTORS.csv\n");
        return 2;
    }
    while (n < MOST && fgets(line, sizeof line, file)) {
        char *next = line;
        double expected, off;
        if (line[0] == '#' || line[0] == 'y')
            continue;
        for (int i = 0; i < 3; i++, next++)
            motion[n][i] = (export_real)strtod(next, &next);
        expected = strtod(next, &next);
        if (n == 0)
            export_init(&axis, motion[0][0]);
        off = fabs((double)export_step(&axis, motion[n][0], motion[n][1], motion[n][2]) - expected);
        worst = off > worst ? off : worst;
        wrong += !(off <= EXPORT_ERROR_V);
        n++;
    }
    fclose(file);
    clock_t begin = clock();
    for (int i = 0; i < TIMES * n; i++)
        sum += (double)export_step(&axis, motion[i % n][0], motion[i % n][1], motion[i % n][2]);
    double point_us = 1e6 * (double)(clock() - begin) / CLOCKS_PER_SEC / (TIMES * (double)n + 1e-9);
    printf("%d points, largest difference %.3g V, stated %.3g V; %.3f us a point (%g)\n", n, worst, EXPORT_ERROR_V,
           point_us, sum / (TIMES * (double)n + 1e-9));
    return n == 0 || wrong > 0;
}
