// SPDX-License-Identifier: GPL-2.0
/*
 * imud_lab: I2C and SPI buses whose devices are simulated in user space.
 *
 *   insmod imud_lab.ko i2c_buses=1 spi_word_bits=8,16 timeout_ms=2000
 *
 * makes /dev/i2c-0, /dev/spidev0.* (8-bit words only, as on a Raspberry Pi) and
 * /dev/spidev1.* (8- and 16-bit words), and for their simulators
 * /dev/imud-lab-i2c0, -spi0 and -spi1 (see protocol.h).
 */
#include <linux/err.h>
#include <linux/module.h>
#include <linux/platform_device.h>

#include "bus.h"

#define MAX_SPI_BUSES 4

static unsigned int i2c_buses = 1;
module_param(i2c_buses, uint, 0444);
MODULE_PARM_DESC(i2c_buses, "number of I2C buses");

static unsigned int spi_word_bits[MAX_SPI_BUSES] = { 8, 16 };
static unsigned int spi_buses = 2;
module_param_array(spi_word_bits, uint, &spi_buses, 0444);
MODULE_PARM_DESC(spi_word_bits, "for each SPI bus: 8 = 8-bit words only, 16 = 8 or 16 bits");

static struct platform_device *root;

static void destroy_all(void)
{
	lab_spi_destroy_all();
	lab_i2c_destroy_all();
	platform_device_unregister(root);
}

static int __init lab_init(void)
{
	int result = 0;

	root = platform_device_register_simple("imud-lab", PLATFORM_DEVID_NONE, NULL, 0);
	if (IS_ERR(root))
		return PTR_ERR(root);
	for (unsigned int i = 0; !result && i < i2c_buses; i++)
		result = lab_i2c_create(&root->dev, i);
	for (unsigned int i = 0; !result && i < spi_buses; i++)
		result = lab_spi_create(&root->dev, i, spi_word_bits[i]);
	if (result)
		destroy_all();
	return result;
}

static void __exit lab_exit(void)
{
	destroy_all();
}

module_init(lab_init);
module_exit(lab_exit);
MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("I2C and SPI buses with simulated devices, for tests");
